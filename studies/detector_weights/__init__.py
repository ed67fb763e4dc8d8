"""Makes the shipped detectors anew: photographs, corpora, trainings, scores and hashes."""
