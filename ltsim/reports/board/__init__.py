"""Interactive planner in the browser: stations are moved by hand, and the accuracy of the layout is updated at once."""
