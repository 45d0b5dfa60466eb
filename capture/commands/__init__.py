"""The commands of `mrbokeh capture`, one file each."""
