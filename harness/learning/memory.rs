//! How much memory a training takes.

/// Copies of every parameter at most: itself, its gradient and that gradient's sum, two moments, the best epoch's, those
/// of the state that is kept and of the one that is being made or written (parameters, moments, best), and what the
/// large products pack. With 34 million parameters, a convolutional network's training was measured to take 19.
const COPIES: usize = 24;
/// The same for what each layer makes of a sample: values, gradients, and what the products pack of both.
const ACTIVATION_COPIES: usize = 4;

/// Memory that training a network takes at most, bytes: a generous estimate.
///
/// # Arguments
/// * `parameters` how many values are trained
/// * `activations` how many values all layers together make of one sample, what goes in and comes out included
/// * `batch` samples a step
pub fn training_bytes(parameters: usize, activations: usize, batch: usize) -> u64 {
    let values = (COPIES as u64).saturating_mul(parameters as u64).saturating_add(
        (ACTIVATION_COPIES as u64).saturating_mul(activations as u64).saturating_mul(batch as u64),
    );
    values.saturating_mul(size_of::<f32>() as u64)
}
