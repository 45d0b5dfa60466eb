"""The lens of one photograph from its out-of-focus lights: each is a picture of the opening, cut as its place in the frame sees it."""
