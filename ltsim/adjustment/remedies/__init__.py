"""Undetermined parameters and undetectable effects in a network, and further measurements that determine them."""
