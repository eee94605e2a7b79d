"""Foreign file formats, one module per format."""
