//! Which region each pixel of an image shows, determined by its color or by a segmentation.

use harness_spec::{CLASS_COLORS, IMAGE_CHANNELS, Region};

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

/// Returns the index of the class that a pixel of a segmentation shows, given its red, green and blue; `None` if it
/// shows no class.
pub fn class_of(pixel: [u8; IMAGE_CHANNELS]) -> Option<u8> {
    CLASS_COLORS.iter().position(|(_, color)| *color == pixel).map(|index| index as u8)
}

/// Returns the region that each pixel shows before or after a change, `[pixel]`. Where both images show a region, the
/// later one counts. `region` returns the region of a pixel, given its red, green and blue. The images are bytes,
/// `[channel, row, column]`.
///
/// # Panics
/// When the images differ in size.
pub fn in_either(
    before: &[u8],
    after: &[u8],
    region: impl Fn([u8; IMAGE_CHANNELS]) -> Option<u8>,
) -> Vec<Option<u8>> {
    assert_eq!(before.len(), after.len(), "both images have one size");
    let pixels = before.len() / IMAGE_CHANNELS;
    let region =
        |image: &[u8], pixel: usize| region([image[pixel], image[pixels + pixel], image[2 * pixels + pixel]]);
    // `None` is smaller than any region.
    (0..pixels).map(|pixel| region(before, pixel).max(region(after, pixel))).collect()
}
