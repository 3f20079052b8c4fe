// Round trips between ROS 1 nodelets.
//
//     nodelets CASE NODES SAMPLES WARM_UP OUT
//
// All nodes are nodelets of one pool (a thread that hands out work, and as many workers as there
// are processors); messages are handed over without copying.

#include <nodelet/detail/callback_queue.h>
#include <nodelet/detail/callback_queue_manager.h>
#include <nodelet/nodelet.h>
#include <ros/ros.h>

#include <cstdint>
#include <exception>
#include <iostream>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "exchange.hpp"
#include "ros1_nodes.hpp"

namespace {

using nodelet::detail::CallbackQueue;
using nodelet::detail::CallbackQueueManager;
using nodelet::detail::CallbackQueuePtr;

class PingerNodelet final : public nodelet::Nodelet {
  public:
    explicit PingerNodelet(const exchange::Arguments& arguments) : arguments_(arguments) {}

    ros1::Pinger& Get() { return *pinger_; }

  private:
    void onInit() override {
        pinger_ = std::make_unique<ros1::Pinger>(getNodeHandle(), arguments_);
    }

    const exchange::Arguments& arguments_;
    std::unique_ptr<ros1::Pinger> pinger_;
};

class ListenerNodelet final : public nodelet::Nodelet {
  public:
    explicit ListenerNodelet(std::uint32_t number) : number_(number) {}

    const ros1::Listener& Get() const { return *listener_; }

  private:
    void onInit() override {
        listener_ = std::make_unique<ros1::Listener>(getNodeHandle(), number_);
    }

    std::uint32_t number_;
    std::unique_ptr<ros1::Listener> listener_;
};

// A nodelet and its two queues, in the pool: what nodelet::Loader does when it loads one, short of
// looking for a plug-in. (The loader itself takes nodelets from elsewhere than plug-ins, too, but
// then has no pool and crashes with the first message.)
template <typename N>
class Loaded {
  public:
    Loaded(const std::string& name, std::unique_ptr<N> nodelet, CallbackQueueManager& pool)
        : pool_(pool),
          one_thread_(boost::make_shared<CallbackQueue>(&pool)),
          any_thread_(boost::make_shared<CallbackQueue>(&pool)),
          nodelet_(std::move(nodelet)) {
        pool.addQueue(one_thread_, false);
        pool.addQueue(any_thread_, true);
        nodelet_->init(name, {}, {}, one_thread_.get(), any_thread_.get());
    }

    Loaded(const Loaded&) = delete;
    Loaded& operator=(const Loaded&) = delete;

    ~Loaded() {
        one_thread_->disable();
        any_thread_->disable();
        nodelet_.reset();
        pool_.removeQueue(one_thread_);
        pool_.removeQueue(any_thread_);
    }

    auto& Get() const { return nodelet_->Get(); }

  private:
    CallbackQueueManager& pool_;
    CallbackQueuePtr one_thread_;
    CallbackQueuePtr any_thread_;
    std::unique_ptr<N> nodelet_;
};

void Measure(const exchange::Arguments& arguments) {
    ros1::Init("nodelets");
    CallbackQueueManager pool;
    const Loaded<PingerNodelet> pinger("/node_1", std::make_unique<PingerNodelet>(arguments), pool);
    std::vector<std::unique_ptr<Loaded<ListenerNodelet>>> listeners;
    for (std::uint32_t number = 2; number <= arguments.nodes; ++number) {
        listeners.push_back(std::make_unique<Loaded<ListenerNodelet>>(
            "/node_" + std::to_string(number), std::make_unique<ListenerNodelet>(number), pool));
    }

    const auto turn = [&] { pinger.Get().WaitForPong(); };
    // Listeners run side by side, so some may be at a ping still when its pong has arrived; the
    // next one is not to meet them.
    std::uint64_t sent = 0;
    const auto rest = [&] {
        ++sent;
        for (const auto& listener : listeners) {
            while (listener->Get().Heard() < sent) {
                std::this_thread::yield();
            }
        }
    };
    pinger.Get().Connect(1,
                         turn);  // Of all subscribers in a process, roscpp makes one connection.
    const auto taken = pinger.Get().Exchange(turn, rest);
    exchange::Write(arguments, taken);
}

}  // namespace

int main(int count, char** words) {
    try {
        Measure(exchange::Parse(std::vector<std::string>(words + 1, words + count)));
    } catch (const std::exception& error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
    return 0;
}
