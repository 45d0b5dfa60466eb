"""Evaluation of networks and classical renderers on photographs that none of them has seen."""
