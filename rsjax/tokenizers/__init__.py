"""Images to discrete tokens and back: MAGVIT-2 with lookup-free quantisation, for RGB and colourised depth."""
