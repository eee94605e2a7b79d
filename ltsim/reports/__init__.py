"""Reports: pages, figures and 3D views of all results."""
