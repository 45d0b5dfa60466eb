"""Making virtual light look as if the camera of the photograph had taken it: its exposure, white balance, blacks, falloff and grain.

    from mrbokeh.compositing.plate_look.finishing import Finishing, finished

    look = Finishing(colour=grey_card_match(plate.rgb, PixelBox.parse("812,430,12")), grain=measured_grain(plate.rgb))
    picture = finished(inserted, plate, look, frame=0).rgb

What lies where:
    colour_match     ColourMatch: a gain and a black per channel, the one form in which all that follows speaks
    exposure_match   from what the metadata state: Exposure, matched_exposure
    white_balance    from colour temperatures: white_of_kelvin, white_balance_gain
    grey_card        from a patch of known reflectance: PixelBox, grey_card_match
    black_level      what the darkest places of the photograph show: picked_black, darkest_black
    noise_blocks     a picture cut into blocks: level and residual of each
    noise_level      variance as a function of level, from blocks that hold nothing but noise
    noise_correlation  how noise hangs together between neighbours and channels
    grain            Grain: these three; measured_grain of a picture, measured_grain_of_pair of two frames
    grain_file       Grain as a file
    grain_texture    a periodic texture with such statistics
    grain_light      grain on the virtual part, as much as the sensor would have given
    vignetting       falloff towards the corners: RadialFalloff, FlatField
    lensfun_falloff  RadialFalloff from lensfun's measurements
    light_wrap       light of the photograph around soft edges; off by default
    finishing        Finishing, finished: all of it in the order that a camera has
    look_options     LookOptions, finishing_of: from what a user types
"""
