// Adam over several parameters in one launch.

// The parameters of a launch. The launch has one row of blocks for each.
struct Slots {
    float *parameter[32];
    const float *grad[32];
    float *mean[32];
    float *square[32];
    int len[32];
    // Whether the parameter decays.
    int decays[32];
};

// `factors` are the learning rate, the corrections of both moments, and the share of decaying parameters that remains.
// `gradient_scale` is the factor of all gradients.
extern "C" __global__ void adam(
    Slots slots, float beta_mean, float beta_square, float epsilon, const float *factors, const float *gradient_scale
) {
    int slot = blockIdx.y, len = slots.len[slot];
    float scale_grad = *gradient_scale, learning_rate = factors[0], mean_correction = factors[1];
    float square_correction = factors[2], kept = slots.decays[slot] ? factors[3] : 1.0f;
    float *parameter = slots.parameter[slot], *means = slots.mean[slot], *squares = slots.square[slot];
    const float *grads = slots.grad[slot];
    for (int index = blockIdx.x * blockDim.x + threadIdx.x; index < len; index += gridDim.x * blockDim.x) {
        float grad = grads[index] * scale_grad;
        float mean = means[index], square = squares[index];
        mean += (1.0f - beta_mean) * (grad - mean);
        square += (1.0f - beta_square) * (grad * grad - square);
        float scale = sqrtf(square * square_correction) + epsilon;
        parameter[index] = parameter[index] * kept
            - learning_rate * mean * mean_correction / scale;
        means[index] = mean;
        squares[index] = square;
    }
}
