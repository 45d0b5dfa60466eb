"""The networks: Neural Bokeh as published, its gated form, and the two networks it is compared with."""
