//! Which region each pixel of an image shows, determined by its color.

use harness_spec::{IMAGE_CHANNELS, Region};

/// Returns the index of the region that a pixel shows, given its red, green and blue; `None` if it shows no region.
///
/// Regions are distinguished by (red - blue) / brightest channel. This value does not depend on the brightness of a
/// surface, as long as colors are not blended.
pub fn region_of(regions: &[Region], [red, green, blue]: [u8; 3]) -> Option<u8> {
    let brightest = f32::from(red.max(green).max(blue)).max(1.0);
    let warmth = (f32::from(red) - f32::from(blue)) / brightest;
    let fits = |region: &Region| (region.red_minus_blue[0]..region.red_minus_blue[1]).contains(&warmth);
    regions.iter().rposition(fits).map(|index| index as u8)
}

/// Returns the region that each pixel shows before or after a change, `[pixel]`. Where both images show a region, the
/// one that comes later in `regions` counts. The images are bytes, `[channel, row, column]`.
///
/// # Panics
/// When the images differ in size.
pub fn in_either(regions: &[Region], before: &[u8], after: &[u8]) -> Vec<Option<u8>> {
    assert_eq!(before.len(), after.len(), "both images have one size");
    let pixels = before.len() / IMAGE_CHANNELS;
    let region = |image: &[u8], pixel: usize| {
        region_of(regions, [image[pixel], image[pixels + pixel], image[2 * pixels + pixel]])
    };
    // `None` is smaller than any region.
    (0..pixels).map(|pixel| region(before, pixel).max(region(after, pixel))).collect()
}
