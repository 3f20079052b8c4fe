// Round trips through the thesis's client.
//
//     thesis_client CASE NODES SAMPLES WARM_UP OUT
//     thesis_client check      prints in which order nodes hear events, for the tests

#include "thesis_client.hpp"

#include <cstdint>
#include <exception>
#include <iostream>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "exchange.hpp"
#include "thesis_messages.hpp"

namespace {

using exchange::Arguments;
using thesis::Client;
using thesis::Nothing;
using thesis::Ping;
using thesis::Pong;

// Node 1: sends a ping in each update, and ends the client when it has its samples.
template <typename Payload>
class Pinger final : public thesis::Node {
  public:
    Pinger(const Arguments& arguments, Payload payload, std::vector<std::int64_t>& taken)
        : arguments_(arguments), payload_(std::move(payload)), taken_(taken) {}

    void OnStartup() override {
        dispatcher_.Handle<Pong>([this](const Pong& pong) {
            arrived_ = exchange::Now();
            ponged_ = pong.number;
            return true;
        });
    }

    void OnUpdate() override {
        if (number_ == arguments_.Total()) {
            thesis::ShutdownEvent shutdown;
            Send(shutdown);
            return;
        }
        const std::int64_t begin = exchange::Now();
        Ping<Payload> ping(1, arguments_.nodes, number_, begin, payload_);
        Send(ping);
        if (ponged_ != number_) {
            throw std::runtime_error("no pong for ping " + std::to_string(number_));
        }
        taken_[number_++] = arrived_ - begin;
    }

    void OnEvent(thesis::Event& event) override { dispatcher_.Dispatch(event); }

  private:
    const Arguments& arguments_;
    const Payload payload_;
    std::vector<std::int64_t>& taken_;
    thesis::EventDispatcher dispatcher_;
    std::uint64_t number_ = 0;
    std::uint64_t ponged_ = ~std::uint64_t{0};
    std::int64_t arrived_ = 0;
};

// Any other node: hears every ping, and replies to those for it.
template <typename Payload>
class Listener final : public thesis::Node {
  public:
    Listener(std::uint32_t number, std::uint64_t expected) : number_(number), expected_(expected) {}

    void OnStartup() override {
        dispatcher_.Handle<Ping<Payload>>([this](const Ping<Payload>& ping) {
            ++heard_;
            if (ping.receiver != number_) {
                return false;
            }
            Pong pong(number_, ping.sender, ping.number, ping.stamp);
            Send(pong);
            return true;
        });
    }

    void OnEvent(thesis::Event& event) override { dispatcher_.Dispatch(event); }

    void OnShutdown() override {
        exchange::ExpectHeard(heard_, expected_, "node " + std::to_string(number_));
    }

  private:
    std::uint32_t number_;
    std::uint64_t expected_;
    std::uint64_t heard_ = 0;
    thesis::EventDispatcher dispatcher_;
};

template <typename Payload>
void Measure(const Arguments& arguments, Payload payload) {
    std::vector<std::int64_t> taken(arguments.Total());
    Client client;
    client.AddNode(std::make_unique<Pinger<Payload>>(arguments, std::move(payload), taken));
    for (std::uint32_t number = 2; number <= arguments.nodes; ++number) {
        client.AddNode(std::make_unique<Listener<Payload>>(number, arguments.Total()));
    }
    client.Run();
    exchange::Write(arguments, taken);
}

// Prints its name when it hears of a pong, and handles it if told to.
class Witness final : public thesis::Node {
  public:
    Witness(int number, bool handles) : number_(number), handles_(handles) {}

    void OnStartup() override {
        dispatcher_.Handle<Pong>([this] {  // This one is without the event.
            std::cout << ' ' << number_;
            return handles_;
        });
    }

    void OnEvent(thesis::Event& event) override { dispatcher_.Dispatch(event); }

  private:
    int number_;
    bool handles_;
    thesis::EventDispatcher dispatcher_;
};

// Sends a pong in its only update.
class Sender final : public thesis::Node {
  public:
    void OnUpdate() override {
        Pong pong(1, 2, 3, 4);
        Send(pong);
        std::cout << (pong.handled ? " handled" : " unhandled") << '\n';
        thesis::ShutdownEvent shutdown;
        Send(shutdown);
    }

    void OnEvent(thesis::Event&) override {}
};

// Lets three nodes hear a pong, of which number `handler` handles it; 0 is none.
void Check(int handler) {
    Client client;
    client.AddNode(std::make_unique<Sender>());
    for (int number = 1; number <= 3; ++number) {
        client.AddNode(std::make_unique<Witness>(number, number == handler));
    }
    std::cout << "heard by";
    client.Run();
}

}  // namespace

int main(int count, char** words) {
    try {
        const std::vector<std::string> arguments(words + 1, words + count);
        if (arguments == std::vector<std::string>{"check"}) {
            Check(0);
            Check(2);
            return 0;
        }
        const Arguments parsed = exchange::Parse(arguments);
        switch (parsed.which) {
            case exchange::Case::kSmall:
                Measure(parsed, Nothing{});
                break;
            case exchange::Case::kLarge:
                Measure(parsed, exchange::LargeArray());
                break;
            case exchange::Case::kLargeShared:
                Measure(parsed, std::make_shared<const exchange::Pixels>(exchange::LargeArray()));
                break;
        }
    } catch (const std::exception& error) {
        std::cerr << error.what() << '\n';
        return 1;
    }
    return 0;
}
