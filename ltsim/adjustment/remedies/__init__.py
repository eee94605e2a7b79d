"""What a network cannot tell, and which further measurement would: undetermined, undecided, undetectable."""
