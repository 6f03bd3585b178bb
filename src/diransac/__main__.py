"""``python -m diransac`` is the command ``diransac``."""

from diransac.cli import main

main()
