"""Cells, headers and rows of delimited text and workbooks, whatever the rows mean."""
