"""Delimited text and workbooks: from bytes to rows, from the header to roles, conventions, and the recording."""
