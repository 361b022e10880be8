"""The latent model: VAE, hidden Markov model, EM and Gaussian mixture regression."""
