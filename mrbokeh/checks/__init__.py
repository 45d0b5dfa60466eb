"""Checks of finished pictures, sequences and films, for render farms: what is broken, what leaked, what flickers."""
