"""rtid: learns valve flow maps and the bulk modulus of a hydraulic machine from CAN frames."""

__version__ = "0.1.0"
