"""What is durable: the data folder, a run's folder, its frames, its journal."""
