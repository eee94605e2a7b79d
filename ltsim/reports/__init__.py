"""Reports: figures, 3D views and HTML pages; the only package that creates figures."""
