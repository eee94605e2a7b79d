"""What a report says of each kind of folder: one file a kind, each a function from a folder to a Section."""
