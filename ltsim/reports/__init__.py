"""Reports: pages, figures and 3D views of all results."""

from ltsim.core.library_settings import without_settings_file

with without_settings_file("matplotlibrc") as _is_present:
    if _is_present:  # otherwise it is imported when the first figure is drawn
        import matplotlib  # noqa: F401
