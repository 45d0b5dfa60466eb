"""One file per command of `mrbokeh` that needs this package alone."""
