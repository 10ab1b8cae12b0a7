// The mean losses of quantities whose columns lie side by side.

// The quantities. Their columns divide a row from left to right.
struct Quantities {
    int count;
    // The column after the last one of each quantity.
    int end[32];
    // 0: squared error, 1: absolute error, 2: Huber loss
    int loss[32];
};

__device__ double value_of(int loss, double error) {
    double size = fabs(error);
    if (loss == 1) return size;
    if (loss == 2 && size > 1.0) return 2.0 * size - 1.0;
    return error * error;
}

__device__ float slope_of(int loss, float error) {
    if (loss == 1) return error == 0.0f ? 0.0f : copysignf(1.0f, error);
    if (loss == 2) return 2.0f * fminf(fmaxf(error, -1.0f), 1.0f);
    return 2.0f * error;
}

// A block computes the mean loss of one quantity (blockIdx.y) over the rows of one part of the batch (blockIdx.x), with
// 1024 threads. `losses` is [quantities, parts].
extern "C" __global__ void vector_losses(
    const float *predicted, const float *target, float *losses, Quantities quantities, int rows, int width
) {
    __shared__ double sums[1024];
    int quantity = blockIdx.y;
    int first = quantity == 0 ? 0 : quantities.end[quantity - 1], columns = quantities.end[quantity] - first;
    long long start = (long long)blockIdx.x * rows * width;
    double sum = 0.0;
    for (int index = threadIdx.x; index < rows * columns; index += blockDim.x) {
        long long at = start + (long long)(index / columns) * width + first + index % columns;
        sum += value_of(quantities.loss[quantity], (double)(predicted[at] - target[at]));
    }
    sums[threadIdx.x] = sum;
    for (int half = 512; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) sums[threadIdx.x] += sums[threadIdx.x + half];
    }
    if (threadIdx.x == 0) losses[quantity * gridDim.x + blockIdx.x] = (float)(sums[0] / ((double)rows * columns));
}

// The gradient of `predicted`. `grad` is that of the losses, [quantities, parts].
extern "C" __global__ void vector_losses_backward(
    const float *predicted, const float *target, const float *grad, float *out, Quantities quantities, int rows,
    int width, int parts
) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index >= parts * rows * width) return;
    int column = index % width, part = index / width / rows, quantity = 0;
    while (column >= quantities.end[quantity]) quantity++;
    int first = quantity == 0 ? 0 : quantities.end[quantity - 1], columns = quantities.end[quantity] - first;
    float factor = grad[quantity * parts + part] / (float)(rows * columns);
    out[index] = factor * slope_of(quantities.loss[quantity], predicted[index] - target[index]);
}
