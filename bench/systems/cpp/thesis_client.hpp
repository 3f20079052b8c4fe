// The thesis's client, written anew from its description: events that know their type, nodes in
// order, and synchronous delivery until somebody has handled the event.
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

namespace thesis {

enum class EventType { kShutdown, kPing, kImagePing, kSharedImagePing, kPong };

enum EventCategory : unsigned { kClientCategory = 1U << 0U, kMessageCategory = 1U << 1U };

class Event {
  public:
    virtual ~Event() = default;
    virtual EventType GetType() const = 0;
    virtual unsigned GetCategories() const = 0;
    virtual std::string ToString() const = 0;

    bool IsIn(EventCategory category) const { return (GetCategories() & category) != 0; }

    bool handled = false;
};

class ShutdownEvent final : public Event {
  public:
    static constexpr EventType kType = EventType::kShutdown;

    EventType GetType() const override { return kType; }
    unsigned GetCategories() const override { return kClientCategory; }
    std::string ToString() const override { return "Shutdown"; }
};

// Holds a handler for each type of event that its owner wants; returning true ends delivery.
class EventDispatcher {
  public:
    // `handler` takes the event, const E&, or nothing.
    template <typename E, typename F>
    void Handle(F handler) {
        // The one std::function that is called is made here from the typed handler: a
        // std::function within another would cost a second indirect call for each event.
        if constexpr (std::is_invocable_r_v<bool, F, const E&>) {
            handlers_.emplace_back(E::kType, [handler](const Event& event) {
                return handler(static_cast<const E&>(event));
            });
        } else {
            static_assert(std::is_invocable_r_v<bool, F>, "expected bool(const E&) or bool()");
            handlers_.emplace_back(E::kType, [handler](const Event&) { return handler(); });
        }
    }

    // Calls the handlers of the event's type until one returns true, and marks the event so.
    void Dispatch(Event& event) const {
        const EventType type = event.GetType();
        for (const auto& [wanted, handler] : handlers_) {
            if (wanted == type && handler(event)) {
                event.handled = true;
                return;
            }
        }
    }

  private:
    // A few at most for each node: looking through them beats hashing.
    std::vector<std::pair<EventType, std::function<bool(const Event&)>>> handlers_;
};

class Node {
  public:
    using EventCallbackFn = std::function<void(Event&)>;

    virtual ~Node() = default;

    void SetEventCallbackFn(EventCallbackFn callback) { callback_ = std::move(callback); }

    virtual void OnStartup() {}
    virtual void OnUpdate() {}
    virtual void OnEvent(Event& event) = 0;
    virtual void OnShutdown() {}

  protected:
    // Returns once every node has heard the event, or one has handled it.
    void Send(Event& event) const { callback_(event); }

  private:
    EventCallbackFn callback_;
};

class Client {
  public:
    Client() {
        dispatcher_.Handle<ShutdownEvent>([this] {
            running_ = false;
            return false;  // Nodes are to hear of it, too.
        });
    }

    // Nodes hold a pointer to their client.
    Client(const Client&) = delete;
    Client& operator=(const Client&) = delete;

    void AddNode(std::unique_ptr<Node> node) {
        node->SetEventCallbackFn([this](Event& event) { OnEvent(event); });
        nodes_.push_back(std::move(node));
    }

    // Starts all nodes, updates them in order until a shutdown event, and shuts them down.
    void Run() {
        running_ = true;
        for (const auto& node : nodes_) {
            node->OnStartup();
        }
        while (running_) {
            for (const auto& node : nodes_) {
                node->OnUpdate();
            }
        }
        for (const auto& node : nodes_) {
            node->OnShutdown();
        }
    }

    void OnEvent(Event& event) {
        dispatcher_.Dispatch(event);
        for (const auto& node : nodes_) {
            if (event.handled) {
                return;
            }
            node->OnEvent(event);
        }
    }

  private:
    std::vector<std::unique_ptr<Node>> nodes_;
    EventDispatcher dispatcher_;
    bool running_ = false;
};

}  // namespace thesis
