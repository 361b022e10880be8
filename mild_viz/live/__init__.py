"""Live operation: skeleton frames in, joint commands out."""
