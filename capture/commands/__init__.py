"""Commands of `mrbokeh capture`, one file each."""
