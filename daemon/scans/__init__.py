"""One file a scan method: a spec becomes steps, an estimator and products."""
