"""Many runs of a scene, over a grid and with random teams, on any number of workers."""
