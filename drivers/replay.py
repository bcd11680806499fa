"""A camera over a folder of images or a video file."""
