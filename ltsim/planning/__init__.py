"""Planning: what a layout of stations and reflectors would tell, before anybody carries an instrument."""
