"""Identification methods, each a frozen object with its own settings."""
