"""Cells, headers and rows of delimited text and workbooks, independent of what the rows describe."""
