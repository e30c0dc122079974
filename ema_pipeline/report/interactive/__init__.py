"""Figures that people zoom, hover and choose in, made once with Bokeh for the report and the live page alike.

`figures` builds them without data; `data` packs the data; the page's script fills the ones with the other.
"""
