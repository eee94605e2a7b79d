"""Undetermined and undetectable quantities of a network, and additional measurements that determine them."""
