"""The rig's devices: their threads, their health, and looks at the scene through them."""
