"""Look of the photograph on virtual light: its exposure, white balance, blacks, falloff, grain and compression.

from mrbokeh.compositing.plate_look.finishing import Finishing, finished

look = Finishing(colour=grey_card_match(plate.rgb, PixelBox.parse("812,430,12")), grain=measured_grain(plate.rgb))
picture = finished(inserted, plate, look, frame=0).rgb

colour_match       ColourMatch: a gain and a black per channel; from a grey card or the darkest places of the photograph
exposure_match     exposure and white balance from stated metadata and colour temperatures
noise_measurement  level and correlation of noise, measured in blocks of a picture
grain              Grain: measured, written, read, and added to virtual light as the sensor would have done
vignetting         falloff towards the corners: RadialFalloff (also from lensfun), FlatField
finishing          Finishing, finished: all of it in the order of a camera; LookOptions, finishing_of: from a user's texts
"""
