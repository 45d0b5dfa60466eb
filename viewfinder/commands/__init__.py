"""The sub-commands of `mrbokeh viewfinder`."""
