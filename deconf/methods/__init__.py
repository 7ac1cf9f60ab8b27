"""One file a method, and the training loops that several share."""
