"""What a run leaves: images, masks, figures, plots, and a report."""
