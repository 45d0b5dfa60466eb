"""Commands of `mrbokeh` that need this package alone, one file each."""
