"""Evidence as the estimators read it: track sets, two-frame windows, tracklets, vehicles."""
