"""Readers and writers of the file formats of other programs and instruments, one module per format."""
