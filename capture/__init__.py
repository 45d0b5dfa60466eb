"""From photographs to FocalStack folders."""
