"""Where the end effector and every drawn link are."""
