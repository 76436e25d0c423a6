"""What a training needs beside the agent: buffers, demonstrations, starts, saving."""
