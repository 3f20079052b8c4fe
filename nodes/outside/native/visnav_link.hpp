// The native interface's client for C++17: feeds a program with a run's images and measurements.
//
// One header, which may be copied; docs/reference/link.md of visnav-runtime has the protocol.
//
//     visnav::Link link("my_slam");            // connects to the socket that $VISNAV_SOCKET names
//     visnav::Camera camera = link.camera(0);
//     link.ready();
//     while (auto frame = link.next())         // until the run ends
//         if (auto pose = track(frame->image("rgb8"), frame->image("depth32f"), frame->rows<visnav::Imu>("imu")))
//             link.pose(*frame, *pose);
//         else
//             link.lost(*frame);
//
// Answers may be given from any thread; one thread receives. Problems are visnav::Error.
#pragma once

#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <exception>
#include <locale>
#include <map>
#include <mutex>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

namespace visnav {

constexpr std::uint32_t version = 2;  // of the protocol

struct Error : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// Rows of the inputs, as they are in a message; what is not known is NaN.

struct Imu {
    static constexpr const char* kind = "imu";
    std::int64_t stamp;                 // ns
    double angular_velocity[3];         // rad/s, in its own axes
    double linear_acceleration[3];      // m/s², specific force
};
struct FluidPressure {
    static constexpr const char* kind = "fluid_pressure";
    std::int64_t stamp;
    double fluid_pressure, variance;    // Pa, Pa²
};
struct MagneticField {
    static constexpr const char* kind = "magnetic_field";
    std::int64_t stamp;
    double magnetic_field[3];           // T, in its own axes
};
struct NavSatFix {
    static constexpr const char* kind = "nav_sat_fix";
    std::int64_t stamp;
    double latitude, longitude, altitude;  // degrees, m above the ellipsoid
    double velocity[3];                    // m/s: north, east, down
    double position_covariance[9];         // m², of the same axes
    std::int64_t status;                   // 0 a fix, -1 none yet
};
struct Range {
    static constexpr const char* kind = "range";
    std::int64_t stamp;
    double range, min_range, max_range;    // m; infinite if nothing is in reach
};
struct LidarPoint {
    static constexpr const char* kind = "lidar_scan";
    std::int64_t stamp;                 // of its ray
    float point[3];                     // m, in the sensor's axes then
    float intensity;
    std::uint64_t ring;
};
struct PoseEstimate {                   // of the body (FRD); NaN: tracking is lost
    static constexpr const char* kind = "pose_estimate";
    std::int64_t stamp;
    std::uint64_t frame;                // number of the frame that it is in, from 0
    double pose[12];                    // 3 rows of 4
    double velocity[3];                 // m/s in that frame
    double covariance[36];              // of a shift and a rotation in that frame
};
static_assert(sizeof(Imu) == 56 && sizeof(NavSatFix) == 136 && sizeof(LidarPoint) == 32 &&
              sizeof(PoseEstimate) == 424 && __BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__);

// Measurements of a sensor in a row, a whole scan, or estimates of another node.
struct Input {
    std::string name, kind;
    std::int64_t arrived;               // when the last one came, on the run's clock (ns)
    std::string bytes;
    template <class T> std::vector<T> rows() const {
        if (kind != T::kind) throw Error("expected " + name + " of kind " + T::kind + ", found " + kind);
        if (bytes.size() % sizeof(T)) throw Error("expected rows of another size of " + name);
        std::vector<T> all(bytes.size() / sizeof(T));
        if (!all.empty()) std::memcpy(all.data(), bytes.data(), bytes.size());
        return all;
    }
};

// An image in shared memory: read-only, valid until its frame has been answered.
struct Image {
    std::uint32_t camera;               // index in the description
    std::string kind;                   // mono8, rgb8, depth32f (metres along z), segmentation32i
    int height, width;
    std::size_t stride;                 // bytes from row to row
    const std::uint8_t* data;
    template <class T> const T* row(int v) const {
        return reinterpret_cast<const T*>(data + stride * static_cast<std::size_t>(v));
    }
};

// The images of one exposure, or another occasion for an answer, and what came before it.
struct Frame {
    std::uint64_t sequence = 0;         // 0, 1, 2, …
    std::int64_t stamp = 0;             // ns
    std::vector<Image> images;
    std::vector<Input> inputs;          // what came since the frame before, in that order
    std::map<std::string, std::string> kinds;  // of all inputs, by name
    template <class T> std::vector<T> rows(const std::string& name) const {
        if (const auto found = kinds.find(name); found == kinds.end() || found->second != T::kind)
            throw Error("expected an input " + name + " of kind " + T::kind);
        Input all{name, T::kind, stamp, ""};
        for (const Input& each : inputs)
            if (each.name == name) all.bytes += each.bytes;
        return all.rows<T>();
    }
    const Image& image(const std::string& kind, std::uint32_t camera = 0) const {
        for (const Image& each : images)
            if (each.camera == camera && each.kind == kind) return each;
        throw Error("expected an image " + kind + " of camera " + std::to_string(camera));
    }
};

// From the optical camera (or the body: see Link::ready) to a frame that stays the same.
struct Pose {
    std::array<double, 12> matrix{1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0};  // 3 rows of 4
    static Pose from_quaternion(double px, double py, double pz, double x, double y, double z,
                                double w) {
        const double s = 2.0 / (x * x + y * y + z * z + w * w);
        return {{1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w), px,
                 s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w), py,
                 s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y), pz}};
    }
};

struct StampedPose {
    std::int64_t stamp;                 // of a frame (ns)
    Pose pose;
};
static_assert(sizeof(StampedPose) == 104);

// The description: its values' texts by their place, as "cameras.0.info.fx": "256.0".
class Description : public std::map<std::string, std::string> {
public:
    explicit Description(const std::string& json = "{}") {
        const char* at = json.c_str();
        read(at, "", 0);
    }
    const std::string& text(const std::string& place) const {
        const auto found = find(place);
        if (found == end()) throw Error("expected " + place + " in the description");
        return found->second;
    }
    double number(const std::string& place) const {  // with a point in any locale
        std::istringstream stream(text(place));
        stream.imbue(std::locale::classic());
        double found = 0.0;
        if (!(stream >> found)) throw Error("expected a number as " + place);
        return found;
    }

private:
    void read(const char*& at, const std::string& place, int depth) {
        const char first = space(at);
        if (first != '{' && first != '[') {
            const std::size_t length = std::strcspn(at, ",]} \n\t\r");
            (*this)[place] = first == '"' ? string(at) : std::string(at, length);
            if (first != '"') at += length;
            return;
        }
        if (depth > 32) throw Error("expected JSON of at most 32 levels");
        ++at;
        for (int n = 0; space(at) != (first == '{' ? '}' : ']'); ++n) {
            if (n > 0) expect(at, ',');
            const std::string key = first == '{' ? string(at) : std::to_string(n);
            if (first == '{') expect(at, ':');
            read(at, place.empty() ? key : place + '.' + key, depth + 1);
        }
        ++at;
    }
    static char space(const char*& at) { return *(at += std::strspn(at, " \n\t\r")); }
    static void expect(const char*& at, char what) {
        if (space(at) != what) throw Error(std::string("expected ") + what + " in JSON");
        ++at;
    }
    static std::string string(const char*& at) {  // \uXXXX stays as it is
        std::string found;
        for (expect(at, '"'); *at != '"'; found += *at++) {
            if (*at == '\\' && at[1] != 'u') ++at;
            if (*at == '\0') throw Error("expected the end of a string in JSON");
        }
        ++at;
        return found;
    }
};

// What most programs need of a camera; Link::description has everything.
struct Camera {
    std::string name, distortion_model;
    std::vector<double> distortion;                // OpenCV's order
    int width, height;
    double fx, fy, cx, cy, rate;
};

class Link {
public:
    enum class PoseOf : std::uint32_t { camera, body };
    enum class Status : std::uint32_t { tracked, lost, initialising };
    enum class Order : std::uint32_t { takeoff, land, position, velocity };
    enum class Axes : std::uint32_t { map, heading };
    using Vector = std::array<double, 3>;

    // Connect to a run; an empty path is $VISNAV_SOCKET.
    explicit Link(const std::string& name, std::string path = "") {
        if (const char* set = std::getenv("VISNAV_SOCKET"); path.empty() && set) path = set;
        sockaddr_un address{};
        address.sun_family = AF_UNIX;
        if (path.size() >= sizeof address.sun_path) throw Error("expected a shorter path: " + path);
        std::memcpy(address.sun_path, path.c_str(), path.size());
        socket_.reset(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
        if (::connect(socket_.fd, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0)
            throw Error("expected the socket of a run at '" + path + "': " + std::strerror(errno));
        send(1, "VISNAVLK" + words(version, 0) + name);
        welcome();
    }
    ~Link() {
        send(5, std::uncaught_exceptions() ? "in an exception" : "");
        if (memory_) ::munmap(memory_, size_);
    }

    const Description& description() const { return description_; }
    Camera camera(std::size_t index) const {
        const std::string place = "cameras." + std::to_string(index) + '.', info = place + "info.";
        const auto get = [&](const std::string& name) { return description_.number(name); };
        Camera found{description_.text(place + "source"),
                     description_.text(info + "distortion_model"), {},
                     static_cast<int>(get(info + "width")), static_cast<int>(get(info + "height")),
                     get(info + "fx"), get(info + "fy"), get(info + "cx"), get(info + "cy"),
                     get(place + "rate")};
        for (std::string name; description_.count(
                 name = info + "distortion." + std::to_string(found.distortion.size()));)
            found.distortion.push_back(get(name));
        return found;
    }

    // Tell the run to begin, and what comes: poses of the optical camera 0, or of the body (FRD), and
    // whether a trajectory when the run has ended.
    void ready(PoseOf of = PoseOf::camera, bool trajectory = false) {
        promised_ = trajectory;
        send(4, words(of, trajectory));
    }

    // Wait for the next frame, with the inputs since the one before; nothing: the run ended.
    std::optional<Frame> next() {
        std::vector<Input> inputs;
        for (;;) {
            const auto [type, body] = receive();
            if (type == 5 && !body.empty()) throw Error("the run has ended the connection: " + body);
            if (type == 5) return std::nullopt;
            if (type == 17) return read_frame(body, std::move(inputs));
            if (type != 16) throw Error("expected INPUT, FRAME or BYE, found another message");
            inputs.push_back(read_input(body));
        }
    }

    // Answer a frame, or give the pose of a further output before that. The covariance is 6×6, of a shift along x, y, z and a rotation about them, the
    // velocity in m/s, both in the frame of the poses; points are columns and rows of tracked
    // features, in turns; a missing inlier flag is 1.
    void pose(const Frame& frame, const Pose& pose, Status status = Status::tracked,
              const std::vector<float>& points = {}, std::vector<std::uint8_t> inliers = {},
              const double* covariance = nullptr, const double* velocity = nullptr,
              const std::string& output = "") {
        const std::size_t count = points.size() / 2;
        inliers.resize(count, 1);
        const int follows = (covariance ? 1 : 0) | (velocity ? 2 : 0);
        std::string body = answer(frame) + words(status, follows, count, number_of(output));
        append(body, pose.matrix.data(), sizeof pose.matrix);
        append(body, covariance, covariance ? 36 * sizeof(double) : 0);
        append(body, velocity, velocity ? 3 * sizeof(double) : 0);
        append(body, points.data(), 2 * count * sizeof(float));
        append(body, inliers.data(), count);
        send(32, body);
    }
    void lost(const Frame& frame) { pose(frame, {}, Status::lost); }
    void initialising(const Frame& frame) { pose(frame, {}, Status::initialising); }
    void done(const Frame& frame) { send(33, answer(frame)); }  // without a pose: it was skipped
    // Fly the vehicle, before the answer to a frame: metres in map (take off to the height -z),
    // m/s along the axes, radians clockwise from north seen from above.
    void order(const Frame& frame, Order order, const Vector& position = {},
               const Vector& velocity = {}, double yaw = 0, double yaw_rate = 0,
               Axes axes = Axes::map) {
        std::string body = answer(frame) + words(order, axes);
        const double numbers[] = {position[0], position[1], position[2], velocity[0],
                                  velocity[1], velocity[2], yaw, yaw_rate};
        append(body, numbers, sizeof numbers);
        send(35, body);
    }
    // Give the final trajectory after the last frame, if ready() promised it: poses of frames, in
    // the frame of those answered, the stamps rising.
    void trajectory(const std::vector<StampedPose>& poses) {
        if (!promised_) throw Error("expected ready(…, true) before a trajectory");
        std::string body;
        append(body, poses.data(), poses.size() * sizeof(StampedPose));
        send(36, body);
    }
    void log(const std::string& text) { send(34, text); }       // a line of the run's log

private:
    struct File {
        int fd = -1;
        void reset(int other) {
            if (fd >= 0) ::close(fd);
            fd = other;
        }
        ~File() { reset(-1); }
    };
    static void append(std::string& body, const void* data, std::size_t size) {
        if (size) body.append(static_cast<const char*>(data), size);
    }
    template <class... T> static std::string words(T... values) {
        const std::uint32_t all[] = {static_cast<std::uint32_t>(values)...};
        return {reinterpret_cast<const char*>(all), sizeof all};
    }
    template <class T> static T get(const std::string& body, std::size_t at) {
        T value{};
        if (at + sizeof value > body.size()) throw Error("expected a longer message from the run");
        std::memcpy(&value, body.data() + at, sizeof value);
        return value;
    }
    static std::string answer(const Frame& frame) {
        std::string body;
        append(body, &frame.sequence, 8);
        append(body, &frame.stamp, 8);
        return body;
    }
    void send(std::uint32_t type, const std::string& body) {
        const std::string message = words(body.size(), type) + body;
        const std::lock_guard<std::mutex> lock(sending_);
        for (std::size_t at = 0; at < message.size();) {
            const ssize_t sent =
                ::send(socket_.fd, message.data() + at, message.size() - at, MSG_NOSIGNAL);
            if (sent < 0 && errno != EINTR) return;  // the run has ended, which next() says
            if (sent > 0) at += static_cast<std::size_t>(sent);
        }
    }

    // Read that many bytes, and a file descriptor that may come with them.
    std::string read(std::size_t size, File* file = nullptr) {
        std::string data(size, '\0');
        for (std::size_t at = 0; at < size;) {
            iovec part{&data[at], size - at};
            alignas(cmsghdr) char control[CMSG_SPACE(sizeof(int))] = {};
            msghdr message{};
            message.msg_iov = &part;
            message.msg_iovlen = 1;
            if (file) message.msg_control = control, message.msg_controllen = sizeof control;
            const ssize_t count = ::recvmsg(socket_.fd, &message, MSG_CMSG_CLOEXEC);
            if (count < 0 && errno == EINTR) continue;
            if (count <= 0) throw Error("the run is gone, without BYE");
            at += static_cast<std::size_t>(count);
            const cmsghdr* head = file ? CMSG_FIRSTHDR(&message) : nullptr;
            if (head && head->cmsg_type == SCM_RIGHTS && head->cmsg_len == CMSG_LEN(sizeof(int))) {
                int fd = -1;
                std::memcpy(&fd, CMSG_DATA(head), sizeof fd);
                file->reset(fd);
            }
        }
        return data;
    }
    std::pair<std::uint32_t, std::string> receive(File* file = nullptr) {
        const auto [length, type] = get<std::array<std::uint32_t, 2>>(read(8, file), 0);
        if (length > (1u << 24)) throw Error("expected at most 16 MiB in a message");
        return {type, read(length)};
    }

    void welcome() {
        File file;
        const auto [type, body] = receive(&file);
        if (body.compare(0, 8, "VISNAVLK") != 0 || (type != 2 && type != 3))
            throw Error("expected a run of visnav-runtime, found something else");
        if (type == 3) throw Error("the run refuses: " + body.substr(16));
        if (const auto found = get<std::uint32_t>(body, 8); found != version) {
            const std::string problem = "expected version " + std::to_string(version) +
                                        " of the protocol, the run has " + std::to_string(found);
            send(5, problem);
            throw Error(problem);
        }
        const auto size = get<std::uint64_t>(body, 16);
        if (file.fd < 0 || size == 0 || static_cast<off_t>(size) > ::lseek(file.fd, 0, SEEK_END))
            throw Error("expected the run's shared memory with WELCOME");
        description_ = Description(body.substr(24));
        for (std::string place; description_.count(
                 (place = "inputs." + std::to_string(inputs_.size()) + '.') + "name");)
            inputs_.emplace_back(description_.text(place + "name"), description_.text(place + "kind"));
        void* mapped = ::mmap(nullptr, size, PROT_READ, MAP_SHARED, file.fd, 0);
        if (mapped == MAP_FAILED) throw Error(std::string("mmap: ") + std::strerror(errno));
        memory_ = mapped;
        size_ = size;
    }

    std::uint32_t number_of(const std::string& output) const {
        if (output.empty()) return 0;
        for (std::uint32_t n = 0;; ++n)
            if (description_.text("outputs." + std::to_string(n)) == output) return n + 1;
    }

    Input read_input(const std::string& body) const {
        static const std::map<std::string, std::size_t> sizes{
            {Imu::kind, sizeof(Imu)}, {FluidPressure::kind, sizeof(FluidPressure)},
            {MagneticField::kind, sizeof(MagneticField)}, {NavSatFix::kind, sizeof(NavSatFix)},
            {Range::kind, sizeof(Range)}, {LidarPoint::kind, sizeof(LidarPoint)},
            {PoseEstimate::kind, sizeof(PoseEstimate)}};
        const auto [number, count] = get<std::array<std::uint32_t, 2>>(body, 0);
        const auto arrived = get<std::int64_t>(body, 8);
        if (number >= inputs_.size()) throw Error("expected an input of the description");
        const auto& [name, kind] = inputs_[number];
        const auto known = sizes.find(kind);  // other kinds are in the description
        const std::size_t size = known != sizes.end() ? known->second : static_cast<std::size_t>(
            description_.number("inputs." + std::to_string(number) + ".row_bytes"));
        if (body.size() != 16 + std::size_t{count} * size)
            throw Error("expected whole rows of the input " + name);
        return {name, kind, arrived, body.substr(16)};
    }

    Frame read_frame(const std::string& body, std::vector<Input> inputs) {
        static const char* const kinds[] = {"mono8", "rgb8", "depth32f", "segmentation32i"};
        static const std::size_t pixels[] = {1, 3, 4, 4};
        Frame frame{get<std::uint64_t>(body, 0), get<std::int64_t>(body, 8), {}, std::move(inputs),
                    {inputs_.begin(), inputs_.end()}};
        const std::size_t count = get<std::uint32_t>(body, 16);
        if (frame.sequence != expected_++) throw Error("expected the next frame, found another");
        if (body.size() != 24 + count * 32) throw Error("expected a frame of another length");
        for (std::size_t at = 24; at < body.size(); at += 32) {
            const auto [camera, kind, height, width, stride, _] =
                get<std::array<std::uint32_t, 6>>(body, at);
            const auto offset = get<std::uint64_t>(body, at + 24);
            if (kind < 1 || kind > 4) throw Error("expected a known kind of image");
            if (height > 65535 || width > 65535 || width * pixels[kind - 1] > stride ||
                offset > size_ || std::uint64_t{height} * stride > size_ - offset)
                throw Error("expected an image inside the shared memory");
            frame.images.push_back({camera, kinds[kind - 1],
                                    static_cast<int>(height), static_cast<int>(width), stride,
                                    static_cast<const std::uint8_t*>(memory_) + offset});
        }
        return frame;
    }

    File socket_;
    std::mutex sending_;
    Description description_;
    std::vector<std::pair<std::string, std::string>> inputs_;  // name and kind
    void* memory_ = nullptr;
    std::size_t size_ = 0;
    std::uint64_t expected_ = 0;
    bool promised_ = false;             // a trajectory
};

}  // namespace visnav
