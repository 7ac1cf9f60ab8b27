"""What several methods share: data, networks, beliefs, models, agents."""
