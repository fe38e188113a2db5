"""HDF5 files in the layouts of robomimic and ACT."""

from imfvla.sources.hdf5.source import Hdf5Source, open_source

__all__ = ["Hdf5Source", "open_source"]
