//! An estimate of the memory that a training takes.

/// Upper bound on the copies of each parameter: the parameter, its gradient and the sum of its gradients, two moments,
/// the best epoch's value, the kept state and the state that is being made or written (parameter, moments and best
/// value each), and what large products pack. Training a convolutional network with 34 million parameters was measured
/// to take 19 copies.
const COPIES: usize = 24;
/// Upper bound on the copies of each layer's output: values, gradients, and what the products pack of both.
const ACTIVATION_COPIES: usize = 4;

/// Returns an upper estimate of the memory that training a network takes, in bytes.
///
/// # Arguments
/// * `parameters`: number of trained values
/// * `activations`: number of values that all layers produce for one sample, including the network's input and output
/// * `batch`: number of samples in a step
pub fn training_bytes(parameters: usize, activations: usize, batch: usize) -> u64 {
    let values = (COPIES as u64).saturating_mul(parameters as u64).saturating_add(
        (ACTIVATION_COPIES as u64).saturating_mul(activations as u64).saturating_mul(batch as u64),
    );
    values.saturating_mul(size_of::<f32>() as u64)
}
