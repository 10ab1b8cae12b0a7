//! Which pixels of a camera frame show the finger and which the arm, told by their colours.

use crate::spec::{FRAME_LEN, FRAME_SIDE};

/// Pixels of a frame.
pub const PIXELS: usize = FRAME_SIDE * FRAME_SIDE;

/// A part of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Part {
    Arm,
    Finger,
}

impl Part {
    /// What a pixel shows, given its red, green and blue; `None` for ground and boxes.
    ///
    /// One number tells them apart in the built-in models, however light a surface is, since nothing is blended:
    /// (red - blue) / brightest channel. In 1000 frames of both scenarios it was 0.45 to 1 on the finger (yellow to
    /// crimson), 0 to 0.05 on the ground (light grey), -0.36 to -0.17 on the arm (bluish dark grey), and -0.75 to
    /// -0.55 on the boxes (blue, green). The bounds lie in the middle of the gaps. Models of other colours need others.
    pub fn of([red, green, blue]: [u8; 3]) -> Option<Part> {
        let brightest = f32::from(red.max(green).max(blue)).max(1.0);
        let warmth = (f32::from(red) - f32::from(blue)) / brightest;
        match warmth {
            0.25.. => Some(Part::Finger),
            -0.45..-0.1 => Some(Part::Arm),
            _ => None,
        }
    }

    /// The part that each pixel shows before or after a change, `[pixel]`: the finger in either frame, or else the
    /// arm in either. Both frames are bytes `[channel, row, column]`.
    ///
    /// # Panics
    /// A frame has another size.
    pub fn in_either(before: &[u8], after: &[u8]) -> Vec<Option<Part>> {
        assert_eq!([before.len(), after.len()], [FRAME_LEN; 2], "a frame has {FRAME_LEN} bytes");
        let part = |frame: &[u8], pixel: usize| {
            Part::of([frame[pixel], frame[PIXELS + pixel], frame[2 * PIXELS + pixel]])
        };
        // `Finger` is the larger of the two, and no part the least.
        (0..PIXELS).map(|pixel| part(before, pixel).max(part(after, pixel))).collect()
    }
}
