// Some rows of a frame, drawn by one thread: which triangle each pixel sees, and its colour.
#pragma once

#include "scene.hpp"

namespace raster {

class Band {
  public:
    Band(Scene& scene, int first, int last, const Images& images, Memory& memory);
    void clear();          // begin a frame
    void cover();          // what is new of the scene's solid triangles
    void hide();           // find the farthest in squares of pixels
    void shadow(const Triangle& triangle);  // the depth of one triangle alone, into a square image
    void shade();          // all but what needs the rows of other bands
    void find_outlines();  // when all bands are shaded
    void finish();         // when all have found theirs

  private:
    struct End {
        float share;  // 0 to 1 of the way, or 2 if it does not end there
        Vec3f plane;  // through the edge where it does
    };
    struct Outline {  // a pixel that an outline crosses
        std::uint8_t* pixel;
        std::uint8_t colour[3];  // of its neighbour, and how much that covers of it, in 256ths
        int share;
    };

    struct Opacity {  // of a triangle: its planes, each times the ray
        float depth[3], u[3], v[3];
        float vertices[3];
        bool by_vertices;  // whether these have one
        const Texture* texture;   // null if it has none
        const float* thresholds;  // by its sizes
        int sizes;
    };

    static constexpr int most_triangles = 64;  // of a pixel that are walked over
    struct Span {  // pixels side by side with one level of a mipmap, in 256ths
        std::int32_t surface;  // number of theirs; -1 for the sky
        int x, count, level;
        float nearest;  // inverse depth in the middle
    };
    struct Run {  // pixels of a row that see one triangle, or none (-1): left to right - 1
        int left, right;
        std::int32_t number;
    };
    static constexpr int most_side_by_side = 16;

    // A mipmap's level whose texels are as large as a pixel blurs more than the pixel; so many 256ths
    // below it are nearer to the mean of 16 samples. 128 would be nearest, but too far from MuJoCo's.
    static constexpr int sharper = 64;

    const Triangle& triangle(std::int32_t number) const;
    std::int32_t& surface_of(std::int32_t number);
    std::int32_t surface(std::int32_t number, int y);
    const Moving& moving(std::int32_t number) const;
    Corners between_poses(std::int32_t number, int y) const;
    bool seen(Triangle& row, std::int32_t number, int y) const;
    const Triangle* seen_by(std::int32_t number, int y, Triangle& row) const;
    bool owned(const Triangle& triangle, std::int32_t number, int x, int y) const;
    template <typename Found>
    void over(const Triangle& triangle, std::int32_t number, Found found);
    template <typename Found>
    void over_square(const Triangle& triangle, const Triangle& later, std::int32_t number,
                     int square, int column, int row, int side, Found found);
    template <typename Found>
    void scan_frame(const Triangle& triangle, int top, int bottom, Found found);
    template <typename Found>
    void over_leaf(const Triangle& triangle, std::int32_t number, bool whole, int left, int top,
                   Found found);
    template <typename Found>
    bool scan_pixels(const Triangle& triangle, bool whole, int left, int right, int top,
                     int bottom, Found found) const;
    template <typename Found>
    void runs(int y, Found found) const;
    void cover(const Triangle& triangle, std::int32_t number);
    void cover_cut(const Triangle& triangle, std::int32_t number);
    void shadow_cut(const Triangle& triangle);
    Opacity opacity(const Triangle& triangle) const;
    Opacity opacity(const Triangle& triangle, const Corners& seen) const;
    iv is_opaque(const Opacity& of, int x, int y, iv asked, fv nearest) const;
    void prefetch(int run) const;
    void prefetch(const Triangle& triangle) const;
    template <bool pinhole>
    void find_levels(int y);
    template <bool pinhole>
    void place(int y);
    template <bool pinhole>
    void place(const Span& span, int y, const float* nearest);
    Area area(std::int32_t caster, const Shade& shade, const Span& span, int y);
    int tile(std::int32_t caster, const Shade& shade, int column, int row, bool look);
    void place_sky(int y, int left, int right);
    void plain(int x);
    Colours colours(int x);
    void mix(int x, int y, float nearest, std::int32_t number);
    void write(std::uint8_t* to, Colours colours, int count) const;
    End end(const Triangle& triangle, Vec3f from, Vec3f to, int y) const;
    void smooth(int x, int y, bool below);
    void find_below(int y, const std::int32_t* above, const std::int32_t* parts);
    void smooth_outlines() const;
    void blend();
    void measure() const;
    void number(int y, int left, int right, std::int32_t number) const;

    double share(int y) const { return (y - scene_.start_) / scene_.step_; }  // of the way
    std::size_t at(int y) const { return std::size_t(y - view_.first) * lens_.stride; }
    std::size_t leaf(int x, int y) const {
        return std::size_t(y / Lens::smallest - first_ / Lens::smallest) *
                   (lens_.stride / Lens::smallest) + x / Lens::smallest;
    }
    std::uint8_t* row(int y) const {
        return images_.rgb + std::size_t(y - view_.first) * lens_.width * 3;
    }

    Scene& scene_;
    const Lens& lens_;
    const View& view_;
    const int first_, last_;  // rows: first to last - 1
    const Images images_;
    std::uint8_t* const end_;  // of its rows of colours
    float* const nearest_;     // of the frame
    std::int32_t* const visible_;
    std::vector<Tile>& tiles_;  // that are known
    Taps taps_;
    std::vector<Outline> outlines_;
    std::size_t first_row_ = 0;  // how many are within its first row
    std::vector<std::size_t> covered_;  // how many triangles of each of the scene's parts
    std::vector<Run> runs_;  // of a row
    std::vector<Span> spans_;
    std::vector<float> farthest_;  // least inverse depth in each of the lens's smallest squares
    std::vector<Surface>& surfaces_;
    std::vector<Shade>& shades_;
    std::vector<Vec3f> light_;  // of a triangle's corners, by light and corner
    std::vector<Area> areas_;  // of the lights, for a span
    std::vector<std::vector<std::int32_t>>& surface_of_;  // by part and triangle; -1: none yet
};

// Call found(left, right, number) for pixels side by side that see one triangle, or none (-1).
template <typename Found>
inline void Band::runs(int y, Found found) const {
    const std::int32_t* seen = visible_ + at(y);
    int left = 0;
    for (int x = 0; x < lens_.width; x += lanes) {
        int ends = bits(load<iv>(seen + x) != load<iv>(seen + x + 1));
        if (const int rest = lens_.width - 1 - x; rest < lanes)
            ends = (ends & ((1 << rest) - 1)) | 1 << rest;
        for (; ends; ends &= ends - 1) {
            const int right = x + __builtin_ctz(ends) + 1;
            found(left, right, seen[left]);
            left = right;
        }
    }
}

}  // namespace raster
