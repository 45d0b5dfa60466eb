"""Registration of the slices of a focal stack: one plane transform per slice, from tracked corners."""
