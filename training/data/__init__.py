"""Training data: focal stacks, their pairs of sharp picture and photographed slice, and random crops of them."""
