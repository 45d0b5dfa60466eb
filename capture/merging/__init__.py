"""The slices of one stack into an all-in-focus picture and depth."""
