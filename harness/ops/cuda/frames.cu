// Frames of samples, and the dropout of their activations.

// Normalized frames of the samples `rows`, [batch][len]. `bytes` are the frames of all samples. With `before`, the
// frame before each sample is subtracted.
extern "C" __global__ void gather_frames(
    const unsigned char *bytes, const unsigned *rows, const unsigned *before, const float *mean, float factor,
    float *frames, int batch, int len
) {
    int value = blockIdx.x * blockDim.x + threadIdx.x;
    if (value >= len) return;
    float shift = mean[value];
    for (int frame = blockIdx.y; frame < batch; frame += gridDim.y) {
        unsigned row = rows[frame];
        float steps = bytes[(long long)row * len + value];
        if (before) steps -= bytes[(long long)before[row] * len + value];
        // Rounded as on the CPU, without a fused multiplication and addition.
        frames[(long long)frame * len + value] =
            __fmul_rn(__fsub_rn(__fmul_rn(steps, 1.0f / 255.0f), shift), factor);
    }
}

__device__ __forceinline__ unsigned rotated(unsigned value, int bits) { return value << bits | value >> (32 - bits); }

__device__ __forceinline__ void quarter_round(unsigned &a, unsigned &b, unsigned &c, unsigned &d) {
    a += b; d = rotated(d ^ a, 16);
    c += d; b = rotated(b ^ c, 12);
    a += b; d = rotated(d ^ a, 8);
    c += d; b = rotated(b ^ c, 7);
}

// Sets values to zero or scales them, as `Dropout::apply` does: with the numbers of ChaCha8 (Bernstein, 2008), whose
// stream is the sample. A thread computes one block of numbers, which decides on 32 values.
extern "C" __global__ void drop(
    float *values, const unsigned *key, int left_out, float scale, int batch, int len, int blocks
) {
    int index = blockIdx.x * blockDim.x + threadIdx.x;
    if (index >= batch * blocks) return;
    unsigned sample = index / blocks, block = index % blocks;
    unsigned start[16] = {0x61707865, 0x3320646e, 0x79622d32, 0x6b206574, key[0], key[1], key[2], key[3],
        key[4], key[5], key[6], key[7], block, 0, sample, 0};
    unsigned state[16];
#pragma unroll
    for (int word = 0; word < 16; word++) state[word] = start[word];
#pragma unroll
    for (int round = 0; round < 4; round++) {
        quarter_round(state[0], state[4], state[8], state[12]);
        quarter_round(state[1], state[5], state[9], state[13]);
        quarter_round(state[2], state[6], state[10], state[14]);
        quarter_round(state[3], state[7], state[11], state[15]);
        quarter_round(state[0], state[5], state[10], state[15]);
        quarter_round(state[1], state[6], state[11], state[12]);
        quarter_round(state[2], state[7], state[8], state[13]);
        quarter_round(state[3], state[4], state[9], state[14]);
    }
    float *own = values + (long long)sample * len;
#pragma unroll
    for (int word = 0; word < 16; word++) {
        unsigned number = state[word] + start[word];
        int at = 32 * block + 2 * word;
        if (at < len) own[at] = (number & 0xffff) < left_out ? 0.0f : own[at] * scale;
        if (at + 1 < len) own[at + 1] = number >> 16 < left_out ? 0.0f : own[at + 1] * scale;
    }
}

// Replaces predicted frames by the gradients of the mean squared error, and sums the squared errors of each block.
// `scale` is 2 divided by the number of values.
extern "C" __global__ void errors(float *predicted, const float *target, double *sums, long long len, float scale) {
    __shared__ double parts[256];
    double sum = 0.0;
    for (long long index = blockIdx.x * 256LL + threadIdx.x; index < len; index += gridDim.x * 256LL) {
        float error = predicted[index] - target[index];
        sum += (double)(error * error);
        predicted[index] = scale * error;
    }
    parts[threadIdx.x] = sum;
    for (int half = 128; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    if (threadIdx.x == 0) sums[blockIdx.x] = parts[0];
}

// The sum of `count` sums divided by `len`. One block of 256 threads.
extern "C" __global__ void mean_of_sums(const double *sums, float *mean, int count, long long len) {
    __shared__ double parts[256];
    double sum = 0.0;
    for (int index = threadIdx.x; index < count; index += 256) sum += sums[index];
    parts[threadIdx.x] = sum;
    for (int half = 128; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    if (threadIdx.x == 0) *mean = (float)(parts[0] / (double)len);
}
