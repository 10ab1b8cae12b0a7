//! Which pixels of an image show which region, told by their colours.

use harness_spec::{IMAGE_CHANNELS, Region};

/// The region that a pixel shows, by its index, given its red, green and blue; `None` where it shows none.
///
/// One number tells them apart, however light a surface is, as long as nothing is blended: (red - blue) / brightest
/// channel.
pub fn region_of(regions: &[Region], [red, green, blue]: [u8; 3]) -> Option<u8> {
    let brightest = f32::from(red.max(green).max(blue)).max(1.0);
    let warmth = (f32::from(red) - f32::from(blue)) / brightest;
    let fits = |region: &Region| (region.red_minus_blue[0]..region.red_minus_blue[1]).contains(&warmth);
    regions.iter().rposition(fits).map(|index| index as u8)
}

/// The region that each pixel shows before or after a change, `[pixel]`; of two, the later one. Both images are bytes
/// `[channel, row, column]`.
///
/// # Panics
/// The images differ in size.
pub fn in_either(regions: &[Region], before: &[u8], after: &[u8]) -> Vec<Option<u8>> {
    assert_eq!(before.len(), after.len(), "both images have one size");
    let pixels = before.len() / IMAGE_CHANNELS;
    let region = |image: &[u8], pixel: usize| {
        region_of(regions, [image[pixel], image[pixels + pixel], image[2 * pixels + pixel]])
    };
    // No region is the least.
    (0..pixels).map(|pixel| region(before, pixel).max(region(after, pixel))).collect()
}
