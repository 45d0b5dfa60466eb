"""Streams that are encoded once and sent to many: WebRTC, recordings, webcam."""
