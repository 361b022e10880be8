"""The page: widgets -> Settings -> pipeline -> Rollout -> views. viser lives only here."""
