"""Tables of trained variants: which choice of the network brings how much."""
