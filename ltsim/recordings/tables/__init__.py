"""Recordings from delimited text and workbooks: rows, roles of columns, conventions of readings, assembly."""
