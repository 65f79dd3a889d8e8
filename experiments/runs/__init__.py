"""One run: a scene, constructed cases or a swarm is simulated, observed and summarised."""
