// Passes over matrices whose rows are samples, stored row by row.

// Adds a bias to each row, and sets negative values to zero if `relu`.
extern "C" __global__ void add_bias(float *values, const float *bias, int len, int columns, int relu) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index >= len) return;
    float value = values[index] + bias[index % columns];
    values[index] = relu && value < 0.0f ? 0.0f : value;
}

// Copies gradients times `factor` where the output of a ReLU is positive, and writes zero elsewhere.
extern "C" __global__ void masked(const float *grad, const float *output, float *out, float factor, int len) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index < len) out[index] = output[index] > 0.0f ? factor * grad[index] : 0.0f;
}

// Sums each column. A block of 32 x 32 threads sums 32 columns.
extern "C" __global__ void column_sums(const float *values, float *sums, int rows, int columns) {
    __shared__ float parts[32][33];
    int column = blockIdx.x * 32 + threadIdx.x;
    float sum = 0.0f;
    if (column < columns)
        for (int row = threadIdx.y; row < rows; row += 32) sum += values[(long long)row * columns + column];
    parts[threadIdx.y][threadIdx.x] = sum;
    __syncthreads();
    if (threadIdx.y == 0 && column < columns) {
        sum = 0.0f;
        for (int part = 0; part < 32; part++) sum += parts[part][threadIdx.x];
        sums[column] = sum;
    }
}
