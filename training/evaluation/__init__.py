"""Networks and classical renderers against photographs that none of them has seen."""
