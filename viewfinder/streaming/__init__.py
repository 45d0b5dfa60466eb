"""Encoded once, sent to many: WebRTC and recordings."""
