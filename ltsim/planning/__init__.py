"""Planning: precision and reliability of a layout of stations and reflectors, before anybody carries an instrument."""
