// The rays of a lens, and boxes about them.
#include <algorithm>
#include <limits>

#include "scene.hpp"

namespace raster {

Lens::Lens(int width, int height, const float* x, const float* y, const float* z)
    : pinhole(z == nullptr), width(width), height(height),
      stride((width + widest - 1) / widest * widest) {
    if (pinhole) {
        this->x.assign(stride + widest, std::numeric_limits<float>::quiet_NaN());
        std::copy(x, x + width, this->x.begin());
        this->y.assign(y, y + height);
        step[0] = width > 1 ? (double(x[width - 1]) - x[0]) / (width - 1) : 1.0;
        step[1] = height > 1 ? (double(y[height - 1]) - y[0]) / (height - 1) : 1.0;
        double most = 1;
        for (const float ray : {x[0], x[width - 1], y[0], y[height - 1]})
            most = std::max(most, std::abs(double(ray)));
        is_precise = std::min(step[0], step[1]) > 5e-4 * most;  // of which float32 is off by 1e-6
        for (int k = 0; k < 2; ++k) per_step[k] = inverse(step[k]);
        return;
    }
    for (auto [to, from] : {std::pair{&this->x, x}, std::pair{&this->y, y}, std::pair{&this->z, z}}) {
        to->assign(std::size_t(stride) * height + widest, 0.0f);  // hits nothing
        for (int row = 0; row < height; ++row)
            for (int column = 0; column < width; ++column) {
                const float value = from[std::size_t(row) * width + column];
                if (value == value) (*to)[std::size_t(row) * stride + column] = value;
            }
    }
    while (largest < std::max({width, height, 2 * smallest})) largest *= 2;
    for (int side = 2 * smallest; side <= largest; side *= 2)
        by_level_.emplace_back(std::size_t(largest / side) * (largest / side), -1);
    cut(0, 0, largest);
    find_spots();
}

// Add a square of pixels and those in it; returns its number.
int Lens::cut(int column, int row, int side) {
    const int number = static_cast<int>(squares.size());
    squares.emplace_back();
    by_level_[__builtin_ctz(side / (2 * smallest))]
             [std::size_t(row / side) * (largest / side) + column / side] = number;
    side /= 2;
    for (int part = 0; part < 4; ++part) {
        const int left = column + part % 2 * side, top = row + part / 2 * side;
        Vec3f low{2, 2, 2}, high{-2, -2, -2};
        for (int y = top; y < std::min(top + side, height); ++y)
            for (int x = left; x < std::min(left + side, width); ++x) {
                const Vec3f found = ray(x, y);
                if (found.x == 0 && found.y == 0 && found.z == 0) continue;
                low = {std::min(low.x, found.x), std::min(low.y, found.y), std::min(low.z, found.z)};
                high = {std::max(high.x, found.x), std::max(high.y, found.y),
                        std::max(high.z, found.z)};
            }
        Square& square = squares[number];
        square.low[0][part] = low.x, square.low[1][part] = low.y, square.low[2][part] = low.z;
        square.high[0][part] = high.x, square.high[1][part] = high.y, square.high[2][part] = high.z;
        square.parts[part] = -1;
        if (side > smallest && low.x <= high.x) {
            const int inner = cut(left, top, side);
            squares[number].parts[part] = inner;
        }
    }
    return number;
}

// Number of a direction's part of an octahedron that is unfolded to a square.
std::size_t Lens::spot(Vec3f a) {
    const float share = 1.0f / (std::abs(a.x) + std::abs(a.y) + std::abs(a.z));
    float x = a.x * share, y = a.y * share;
    if (a.z < 0) {
        const float folded = (1 - std::abs(y)) * (x < 0 ? -1 : 1);
        y = (1 - std::abs(x)) * (y < 0 ? -1 : 1), x = folded;
    }
    constexpr float half = spots_across / 2 - 0.01f;
    return static_cast<std::size_t>((y + 1) * half) * spots_across +
           static_cast<std::size_t>((x + 1) * half);
}

void Lens::find_spots() {
    spots_.assign(std::size_t(spots_across) * spots_across, {-1, -1});
    const auto at = [&](int column, int row) {
        const Vec3f found = ray(column, row);
        return Vec3{found.x, found.y, found.z};
    };
    double least = 1, most = 0;  // squares of the turns from pixel to pixel, and of their changes
    for (int row = 1; row < height - 1; ++row)
        for (int column = 1; column < width - 1; ++column) {
            const Vec3 here = at(column, row), left = at(column - 1, row);
            const Vec3 right = at(column + 1, row), above = at(column, row - 1);
            const Vec3 below = at(column, row + 1);
            bool known = true;
            for (const Vec3 each : {here, left, right, above, below}) known &= dot(each, each) > 0;
            if (!known) continue;
            spots_[spot(ray(column, row))] = {static_cast<std::int16_t>(column),
                                              static_cast<std::int16_t>(row)};
            const Vec3 across = right - here, down = below - here;
            const double a = dot(across, across), b = dot(across, down), c = dot(down, down);
            least = std::min(least, 0.5 * (a + c) - root(0.25 * (a - c) * (a - c) + b * b));
            for (const Vec3 change : {right - here * 2.0 + left, below - here * 2.0 + above})
                most = std::max(most, dot(change, change));
        }
    const double scale = 1 / root(std::max(least, 1e-12));  // the most pixels of a radian
    bend = static_cast<float>(scale * scale * scale * root(most));
}

// From a pixel near it by Newton's method, one step.
Lens::Pixel Lens::near_pixel(Vec3 towards) const {
    const double squared = dot(towards, towards);
    if (!(squared > 1e-300 && squared < 1e300)) return {-1, -1};
    const Vec3f ahead = narrow(towards * (1.0 / root(squared)));
    const Spot near = spots_[spot(ahead)];
    if (near.column < 0) return {-1, -1};
    const Vec3f here = ray(near.column, near.row), way = ahead - here;
    const Vec3f across = ray(near.column + 1, near.row) - here;
    const Vec3f down = ray(near.column, near.row + 1) - here;
    const float a = dot(across, across), b = dot(across, down), c = dot(down, down);
    const float u = dot(way, across), v = dot(way, down), area = a * c - b * b;
    if (area == 0) return {-1, -1};
    const float share = 1.0f / area;
    return {near.column + (c * u - b * v) * share, near.row + (a * v - b * u) * share};
}

}  // namespace raster
