"""The Python interface: measuring, loading, drawing; reached as ``import hipsta_bids as hb``."""
