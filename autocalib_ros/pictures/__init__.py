"""Pictures for people: what a calibration makes of an image. Shared by the shells."""
