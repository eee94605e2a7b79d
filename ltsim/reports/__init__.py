"""Pictures and pages: the only package that draws."""
