"""What is around a drogue, painted: hoses, receivers' probes and cockpits, and things that resemble a drogue."""
