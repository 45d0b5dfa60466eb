"""Models of point spread functions: one file per model, all behind `mrbokeh.psf_models.base.PsfModel`."""
