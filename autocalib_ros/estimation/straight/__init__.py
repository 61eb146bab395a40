"""Road directions from straight tracks: consensus, multi-start initialisation, further roads."""
