"""Logs of machines: reading, preparation, and the dataset that a method is given."""
