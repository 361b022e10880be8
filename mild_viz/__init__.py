"""mild_viz: an interactive dashboard for latent interaction dynamics and robot playback."""

__version__ = "0.1.0"
