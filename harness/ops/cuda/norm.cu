// Layer normalization. A block of 256 threads treats one row; `statistics` holds the mean and the inverse of the
// standard deviation of each row.

__device__ float block_sum(float value, float *parts) {
    __syncthreads();
    parts[threadIdx.x] = value;
    for (int half = 128; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    __syncthreads();
    return parts[0];
}

extern "C" __global__ void layer_norm(
    const float *x, const float *weight, const float *bias, float *y, float *statistics, int width, float epsilon
) {
    __shared__ float parts[256];
    const float *row = x + (long long)blockIdx.x * width;
    float sum = 0.0f;
    for (int column = threadIdx.x; column < width; column += 256) sum += row[column];
    float mean = block_sum(sum, parts) / width;
    sum = 0.0f;
    for (int column = threadIdx.x; column < width; column += 256) sum += (row[column] - mean) * (row[column] - mean);
    float inverse = 1.0f / sqrtf(block_sum(sum, parts) / width + epsilon);
    for (int column = threadIdx.x; column < width; column += 256)
        y[(long long)blockIdx.x * width + column] = (row[column] - mean) * inverse * weight[column] + bias[column];
    if (threadIdx.x == 0) {
        statistics[2 * blockIdx.x] = mean;
        statistics[2 * blockIdx.x + 1] = inverse;
    }
}

// `of_x` is the gradient of x, and `product` that of the weight in each row, which is then summed over the rows.
extern "C" __global__ void layer_norm_backward(
    const float *x, const float *weight, const float *statistics, const float *grad, float *of_x, float *product,
    int width
) {
    __shared__ float parts[256];
    long long start = (long long)blockIdx.x * width;
    float mean = statistics[2 * blockIdx.x], inverse = statistics[2 * blockIdx.x + 1];
    float sum = 0.0f, weighted = 0.0f;
    for (int column = threadIdx.x; column < width; column += 256) {
        float normal = (x[start + column] - mean) * inverse, slope = grad[start + column] * weight[column];
        sum += slope;
        weighted += slope * normal;
        product[start + column] = grad[start + column] * normal;
    }
    sum = block_sum(sum, parts) / width;
    weighted = block_sum(weighted, parts) / width;
    for (int column = threadIdx.x; column < width; column += 256) {
        float normal = (x[start + column] - mean) * inverse, slope = grad[start + column] * weight[column];
        of_x[start + column] = inverse * (slope - sum - normal * weighted);
    }
}
