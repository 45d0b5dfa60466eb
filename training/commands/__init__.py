"""The commands of `mrbokeh train`, one module each."""
