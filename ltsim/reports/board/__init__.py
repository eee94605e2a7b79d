"""A plan in the browser: stations moved by hand, and at once what the layout would tell."""
