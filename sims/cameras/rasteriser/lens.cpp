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
    cut(0, 0, largest);
}

// Add a square of pixels and those in it; returns its number.
int Lens::cut(int column, int row, int side) {
    const int number = static_cast<int>(squares.size());
    squares.emplace_back();
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

}  // namespace raster
