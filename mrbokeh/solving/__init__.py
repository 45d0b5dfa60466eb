"""The camera from one picture: straight segments, their vanishing points, focal length, horizon and the ground."""
