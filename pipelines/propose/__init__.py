"""Labels proposed by a model: stretches of recorded runs, questions worth asking, and answers taken over."""
