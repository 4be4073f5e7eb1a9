"""Plant stages and devices: pure functions over arrays of shape (B,)."""
