"""Common code of the recurrent reference detectors: network, training, forecasts, the detector.

Importing the package or its `parameters` does not import torch; its other modules do.
"""
