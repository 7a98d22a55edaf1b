"""From stored numbers to reflectance or radiance: references, bad bands, cropping and binning."""
