"""Identification: dataset -> method -> estimate -> evaluation, and the results that users see."""
