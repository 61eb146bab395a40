"""Images to observations: background, motion mask, KLT tracks, SIFT segments, edges, silhouettes and detections."""
