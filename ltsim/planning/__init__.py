"""Planning: expected precision and reliability of a layout of stations and reflectors before any measurement."""
