"""Dense depth of a scene seen from several viewpoints."""
