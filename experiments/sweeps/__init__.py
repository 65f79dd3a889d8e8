"""Many runs of a scene, over a grid and with random teams: finished on any number of workers, and tabulated."""
