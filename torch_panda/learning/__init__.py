"""Learning: agents, replay buffers, training, evaluation and saved policies."""
