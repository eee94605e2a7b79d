"""Delimited text and workbooks of whatever dialect: bytes to rows, header to meaning, conventions, recording."""
