"""What inverse kinematics minimises: Eq. ik-prior-simplified, and optional terms beside it."""
