// Convolutions of 4 x 4 with a stride of 2 and a padding of 1, between a fine image and a coarse one of half the size.
// Images are [batch][channels][rows][columns], and kernels [coarse channels][fine channels][4][4].

struct Sizes {
    int batch, fine_channels, coarse_channels;
    // Rows and columns of the coarse image. The fine one has twice as many.
    int rows, columns;
};

// What follows a convolution: a bias is added if there is one, then negative values become 0 if `relu`, or values
// become 0 where `mask`, if there is one, is not positive.
struct Then {
    const float *bias, *mask;
    int relu;
};

__device__ __forceinline__ float then(Then next, float value, int channel, long long at) {
    if (next.bias) value += next.bias[channel];
    if (next.relu && value < 0.0f) value = 0.0f;
    if (next.mask && !(next.mask[at] > 0.0f)) value = 0.0f;
    return value;
}

// Number of input channels whose weights are in shared memory at once.
constexpr int CHUNK = 16;

// A thread treats two neighboring coarse pixels: (row, column) and (row, column + 1), of which the second one may be
// outside the image.
struct Pair {
    int image, row, column;
    bool inside;

    __device__ Pair(int position, Sizes sizes) {
        int pairs = (sizes.columns + 1) / 2;
        inside = position < sizes.batch * sizes.rows * pairs;
        image = inside ? position / (sizes.rows * pairs) : 0;
        row = inside ? position / pairs % sizes.rows : 0;
        column = inside ? position % pairs * 2 : 0;
    }
};

// The 4 x 6 fine pixels below a pair of coarse ones, and zeros outside the image `from`.
__device__ __forceinline__ void load_fine(float (&values)[4][6], const float *from, Pair pair, Sizes sizes) {
    int width = 2 * sizes.columns;
    bool left = pair.column > 0, right = pair.column + 2 < sizes.columns, even = sizes.columns % 2 == 0;
    bool second = pair.column + 1 < sizes.columns;
    const float *line = from + (2 * pair.row - 1) * width + 2 * pair.column;
#pragma unroll
    for (int y = 0; y < 4; y++, line += width) {
        bool in_rows = y == 0 ? pair.row > 0 : y == 3 ? pair.row + 1 < sizes.rows : true;
        float4 middle = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        if (in_rows && even) {
            middle = __ldg(reinterpret_cast<const float4 *>(line));
        } else if (in_rows) {
            middle.x = __ldg(line);
            middle.y = __ldg(line + 1);
            if (second) middle.z = __ldg(line + 2), middle.w = __ldg(line + 3);
        }
        values[y][0] = in_rows && left ? __ldg(line - 1) : 0.0f;
        values[y][1] = middle.x;
        values[y][2] = middle.y;
        values[y][3] = middle.z;
        values[y][4] = middle.w;
        values[y][5] = in_rows && right ? __ldg(line + 4) : 0.0f;
    }
}

// The 3 x 4 coarse pixels around a pair of them, and zeros outside the image `from`.
__device__ __forceinline__ void load_coarse(float (&values)[3][4], const float *from, Pair pair, Sizes sizes) {
    bool left = pair.column > 0, second = pair.column + 1 < sizes.columns, right = pair.column + 2 < sizes.columns;
    const float *line = from + (pair.row - 1) * sizes.columns + pair.column;
#pragma unroll
    for (int y = 0; y < 3; y++, line += sizes.columns) {
        bool in_rows = y == 0 ? pair.row > 0 : y == 2 ? pair.row + 1 < sizes.rows : true;
        values[y][0] = in_rows && left ? __ldg(line - 1) : 0.0f;
        values[y][1] = in_rows ? __ldg(line) : 0.0f;
        values[y][2] = in_rows && second ? __ldg(line + 1) : 0.0f;
        values[y][3] = in_rows && right ? __ldg(line + 2) : 0.0f;
    }
}

// From fine to coarse, for `TILE` coarse channels.
template <int TILE>
__device__ void convolve_tile(const float *fine, const float *kernel, float *coarse, Sizes sizes, Then next) {
    __shared__ float weights[CHUNK][16][TILE];
    Pair pair(blockIdx.x * blockDim.x + threadIdx.x, sizes);
    int first = blockIdx.y * TILE, area = sizes.rows * sizes.columns;
    float sums[2][TILE] = {};
    for (int start = 0; start < sizes.fine_channels; start += CHUNK) {
        int channels = min(CHUNK, sizes.fine_channels - start);
        __syncthreads();
        for (int index = threadIdx.x; index < channels * 16 * TILE; index += blockDim.x) {
            int of = index / (16 * channels), rest = index % (16 * channels);
            float weight = first + of < sizes.coarse_channels
                ? kernel[((first + of) * sizes.fine_channels + start) * 16 + rest] : 0.0f;
            weights[rest / 16][rest % 16][of] = weight;
        }
        __syncthreads();
        if (!pair.inside) continue;
        const float *from = fine + ((long long)pair.image * sizes.fine_channels + start) * 4 * area;
        for (int channel = 0; channel < channels; channel++, from += 4 * area) {
            float values[4][6];
            load_fine(values, from, pair, sizes);
#pragma unroll
            for (int y = 0; y < 4; y++)
#pragma unroll
                for (int x = 0; x < 4; x++)
#pragma unroll
                    for (int of = 0; of < TILE; of++) {
                        float weight = weights[channel][4 * y + x][of];
                        sums[0][of] = fmaf(weight, values[y][x], sums[0][of]);
                        sums[1][of] = fmaf(weight, values[y][x + 2], sums[1][of]);
                    }
        }
    }
    if (!pair.inside) return;
#pragma unroll
    for (int of = 0; of < TILE; of++) {
        int channel = first + of;
        if (channel >= sizes.coarse_channels) break;
        long long at = ((long long)pair.image * sizes.coarse_channels + channel) * area + pair.row * sizes.columns;
        at += pair.column;
        coarse[at] = then(next, sums[0][of], channel, at);
        if (pair.column + 1 < sizes.columns) coarse[at + 1] = then(next, sums[1][of], channel, at + 1);
    }
}

extern "C" __global__ void convolve_8(
    const float *fine, const float *kernel, float *coarse, Sizes sizes, Then next) {
    convolve_tile<8>(fine, kernel, coarse, sizes, next);
}

extern "C" __global__ void convolve_4(
    const float *fine, const float *kernel, float *coarse, Sizes sizes, Then next) {
    convolve_tile<4>(fine, kernel, coarse, sizes, next);
}

// From coarse to fine, transposed. A thread computes the 2 x 4 fine pixels below two coarse ones, for `TILE` fine
// channels.
template <int TILE>
__device__ void spread_tile(const float *coarse, const float *kernel, float *fine, Sizes sizes, Then next) {
    __shared__ float weights[CHUNK][16][TILE];
    Pair pair(blockIdx.x * blockDim.x + threadIdx.x, sizes);
    int first = blockIdx.y * TILE, area = sizes.rows * sizes.columns;
    float sums[2][4][TILE] = {};
    for (int start = 0; start < sizes.coarse_channels; start += CHUNK) {
        int channels = min(CHUNK, sizes.coarse_channels - start);
        __syncthreads();
        for (int index = threadIdx.x; index < channels * 16 * TILE; index += blockDim.x) {
            int channel = index / (16 * TILE), of = index / 16 % TILE, tap = index % 16;
            float weight = first + of < sizes.fine_channels
                ? kernel[((start + channel) * sizes.fine_channels + first + of) * 16 + tap] : 0.0f;
            weights[channel][tap][of] = weight;
        }
        __syncthreads();
        if (!pair.inside) continue;
        const float *from = coarse + ((long long)pair.image * sizes.coarse_channels + start) * area;
        for (int channel = 0; channel < channels; channel++, from += area) {
            float values[3][4];
            load_coarse(values, from, pair, sizes);
            // The fine row 2 r + a gets tap 1 - a + 2 k from the coarse row r + a - k, for k = 0 and 1. (The row 2 r
            // gets taps 1 and 3 from the rows r and r - 1, and the row 2 r + 1 gets taps 0 and 2 from r + 1 and r.)
            // Columns likewise.
#pragma unroll
            for (int a = 0; a < 2; a++)
#pragma unroll
                for (int b = 0; b < 4; b++)
#pragma unroll
                    for (int k = 0; k < 2; k++)
#pragma unroll
                        for (int l = 0; l < 2; l++) {
                            float value = values[1 + a - k][1 + b / 2 + b % 2 - l];
                            const float *weight = weights[channel][4 * (1 - a + 2 * k) + 1 - b % 2 + 2 * l];
#pragma unroll
                            for (int of = 0; of < TILE; of++)
                                sums[a][b][of] = fmaf(weight[of], value, sums[a][b][of]);
                        }
        }
    }
    if (!pair.inside) return;
    bool second = pair.column + 1 < sizes.columns;
#pragma unroll
    for (int of = 0; of < TILE; of++) {
        int channel = first + of;
        if (channel >= sizes.fine_channels) break;
#pragma unroll
        for (int a = 0; a < 2; a++) {
            long long line = ((long long)pair.image * sizes.fine_channels + channel) * sizes.rows + pair.row;
            long long at = (2 * line + a) * 2 * sizes.columns + 2 * pair.column;
            float values[4];
#pragma unroll
            for (int b = 0; b < 4; b++)
                values[b] = b < 2 || second ? then(next, sums[a][b][of], channel, at + b) : 0.0f;
            *reinterpret_cast<float2 *>(fine + at) = make_float2(values[0], values[1]);
            if (second) *reinterpret_cast<float2 *>(fine + at + 2) = make_float2(values[2], values[3]);
        }
    }
}

extern "C" __global__ void spread_8(
    const float *coarse, const float *kernel, float *fine, Sizes sizes, Then next) {
    spread_tile<8>(coarse, kernel, fine, sizes, next);
}

extern "C" __global__ void spread_4(
    const float *coarse, const float *kernel, float *fine, Sizes sizes, Then next) {
    spread_tile<4>(coarse, kernel, fine, sizes, next);
}

// Number of coarse channels whose kernel gradients a thread sums.
constexpr int OUTPUTS = 4;
constexpr int GRADIENT_THREADS = 256;

// The gradient of a kernel: one of `fine` and `coarse` is the input, and the other one the gradient of the output. A
// block sums a part of the positions (blockIdx.x) for one fine channel and `OUTPUTS` coarse channels (blockIdx.y).
// `sums` is [parts][coarse channels][fine channels][16].
extern "C" __global__ void __launch_bounds__(GRADIENT_THREADS)
kernel_gradient(const float *fine, const float *coarse, float *sums, Sizes sizes) {
    __shared__ float parts[GRADIENT_THREADS / 32][OUTPUTS * 16];
    int channel = blockIdx.y % sizes.fine_channels, first = blockIdx.y / sizes.fine_channels * OUTPUTS;
    int area = sizes.rows * sizes.columns, pairs = sizes.batch * sizes.rows * ((sizes.columns + 1) / 2);
    float own[OUTPUTS][16] = {};
    for (int position = blockIdx.x * GRADIENT_THREADS + threadIdx.x; position < pairs;
         position += gridDim.x * GRADIENT_THREADS) {
        Pair pair(position, sizes);
        bool second = pair.column + 1 < sizes.columns;
        const float *grads = coarse + ((long long)pair.image * sizes.coarse_channels + first) * area
            + pair.row * sizes.columns + pair.column;
        float left[OUTPUTS], right[OUTPUTS];
#pragma unroll
        for (int of = 0; of < OUTPUTS; of++) {
            bool exists = first + of < sizes.coarse_channels;
            left[of] = exists ? __ldg(grads + of * area) : 0.0f;
            right[of] = exists && second ? __ldg(grads + of * area + 1) : 0.0f;
        }
        float values[4][6];
        load_fine(values, fine + ((long long)pair.image * sizes.fine_channels + channel) * 4 * area, pair, sizes);
#pragma unroll
        for (int y = 0; y < 4; y++)
#pragma unroll
            for (int x = 0; x < 4; x++)
#pragma unroll
                for (int of = 0; of < OUTPUTS; of++) {
                    own[of][4 * y + x] = fmaf(left[of], values[y][x], own[of][4 * y + x]);
                    own[of][4 * y + x] = fmaf(right[of], values[y][x + 2], own[of][4 * y + x]);
                }
    }
    int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
#pragma unroll
    for (int of = 0; of < OUTPUTS; of++)
#pragma unroll
        for (int tap = 0; tap < 16; tap++) {
            float sum = own[of][tap];
#pragma unroll
            for (int step = 16; step > 0; step /= 2) sum += __shfl_down_sync(0xffffffff, sum, step);
            if (lane == 0) parts[warp][16 * of + tap] = sum;
        }
    __syncthreads();
    if (threadIdx.x < OUTPUTS * 16) {
        int of = threadIdx.x / 16, tap = threadIdx.x % 16;
        float sum = 0.0f;
        for (int part = 0; part < GRADIENT_THREADS / 32; part++) sum += parts[part][threadIdx.x];
        long long at = ((long long)blockIdx.x * sizes.coarse_channels + first + of) * sizes.fine_channels + channel;
        if (first + of < sizes.coarse_channels) sums[at * 16 + tap] = sum;
    }
}

// Sums each channel of images over a part of the batch (blockIdx.y). `sums` is [parts][channels]; blockIdx.x is the
// channel.
extern "C" __global__ void channel_sums(const float *images, float *sums, int batch, int channels, int area) {
    __shared__ float parts[256];
    int channel = blockIdx.x, first = blockIdx.y * batch / gridDim.y, end = (blockIdx.y + 1) * batch / gridDim.y;
    float sum = 0.0f;
    for (int index = threadIdx.x; index < (end - first) * area; index += 256) {
        long long image = first + index / area;
        sum += images[(image * channels + channel) * area + index % area];
    }
    parts[threadIdx.x] = sum;
    for (int half = 128; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    if (threadIdx.x == 0) sums[blockIdx.y * channels + channel] = parts[0];
}
