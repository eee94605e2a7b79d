"""Undetermined and undetectable quantities of a network, and further measurements that determine them."""
