"""Commands that measure, and what they share: the engine that runs jobs, and what is made of their results."""
