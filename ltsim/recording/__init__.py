"""Recordings of tracker networks: in memory, in the native folder and in the formats that people have."""
