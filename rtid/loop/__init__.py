"""The fixed-rate loop: absolute deadlines, real-time scheduling where allowed, its statistics."""
