"""Fitting a network: settings, loss, the run and its folder, checkpoints, several processes."""
