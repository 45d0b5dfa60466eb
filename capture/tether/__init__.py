"""Focus bracketing: plan the slices of a focus stack and let a tethered camera take them one after another."""
